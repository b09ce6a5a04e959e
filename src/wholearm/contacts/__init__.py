"""Elemental contacts, slip, formations, what gaps stay open, friction cones."""
