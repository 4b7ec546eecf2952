"""Beams chosen from the field, beside pilots."""
