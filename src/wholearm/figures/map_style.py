"""Colours and names of the map of contact formations."""

from __future__ import annotations

from ..mapping.formation_map import CROSSED

INK, LINE = "#222222", "#9aa1ab"
LOST = ("#ececec", "#b8b8b8", "////")  # face, lines and hatch
AMBIGUOUS = "#AA3377"
CROSSED_LOOK = ("#f6e3ee", "#CC79A7", "\\\\\\\\")
UNREACHED = {
    "finger 1 too short": -1,
    "finger 2 too short": -2,
    "joint 1 in or above the object": -3,
    "joint 2 in or above the object": -4,
    "fingers overlap": CROSSED,
}
"""What is written where nothing can be reached, and its code in `FormationMap.cell`."""
FORTH, BACK, FREE = "#0072B2", "#D55E00", "#7a838f"
TINTS = ("#f3f6fb", "#fbf6ea", "#eef7f0", "#f9eff4", "#f4f1fb", "#eef6f8", "#f7f7ee")
