"""Elements of XML files whose attributes are numbers."""

from __future__ import annotations

from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np


def add(parent: Element, tag: str, **attributes: object) -> Element:
    """Add an element to another; numbers are written with all their digits."""
    texts = {
        key: value
        if isinstance(value, str)
        else " ".join(format(x, ".17g") for x in np.ravel(np.array(value, dtype=float)))
        for key, value in attributes.items()
    }
    return ElementTree.SubElement(parent, tag, texts)
