"""Ranges of numbers that are not known exactly, as limits of a plan."""
