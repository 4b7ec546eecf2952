"""The engine's benchmarks: each knob's speed against error, growth, mesh rays, blending beside torch."""
