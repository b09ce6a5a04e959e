"""The map of contact formations over x and phi, and routes through it."""
