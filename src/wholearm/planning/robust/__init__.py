"""Robust limits of plans over ranges of uncertain parameters."""
