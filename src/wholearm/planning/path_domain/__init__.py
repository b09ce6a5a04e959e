"""Planning of phases with one freedom, along their curves."""
