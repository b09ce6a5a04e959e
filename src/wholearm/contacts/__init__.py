"""Elemental contacts, slip coordinates, formations, gap limits, closed configurations."""
