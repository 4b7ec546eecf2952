"""What receivers get of a field, without their spectra: links of many of them, and maps of a floor."""
