"""Planning of phases with any number of freedoms, in time."""
