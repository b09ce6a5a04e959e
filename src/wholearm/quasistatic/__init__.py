"""Motions so slow that inertia does not count, and the speeds at which they break."""
