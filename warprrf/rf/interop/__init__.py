"""Other tools' formats and engines: Sionna RT, DeepMIMO, NeWRF, scenes for ray tracers."""
