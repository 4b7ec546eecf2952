"""Which effects a scene needs, in a band and to a tolerance."""
