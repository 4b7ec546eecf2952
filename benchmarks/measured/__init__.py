"""Measured places: received power that others measured, predicted where it was held out, beside simple rivals."""
