"""Speed of the engine against its peers."""
