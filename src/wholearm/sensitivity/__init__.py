"""How forces change with numbers that are off."""
