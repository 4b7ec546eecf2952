"""Benchmarks of the engine: each kernel beside a peer measured in the same run."""
