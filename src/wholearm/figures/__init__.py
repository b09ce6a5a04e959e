"""Figures of plans, forces and maps."""
