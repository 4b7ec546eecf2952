"""The bistatic field beside other systems, and what its parts are worth."""
