"""Equations of motion, impacts, and the metric of kinetic energy."""
