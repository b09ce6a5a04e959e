"""Phases with any number of freedoms, planned over time by collocation."""
