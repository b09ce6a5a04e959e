"""One-freedom phases, planned along their curves."""
