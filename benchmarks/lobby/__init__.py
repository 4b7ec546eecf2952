"""The lobby: a furnished room of our own, its photos, its spectra, and the run from one to the other."""
