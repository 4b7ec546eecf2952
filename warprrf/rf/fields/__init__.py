"""Radio fields: one way to fit, ask, save and load, whatever the model."""
