"""The command ``wholearm help``: pages of the documentation, which stand beside the code."""

from __future__ import annotations

import argparse
import posixpath
import re
from importlib import resources

TOPICS = {
    "python": "",
    "file-format": "problem",
    "model": "mechanics",
    "contacts": "contacts",
    "planning": "planning",
    "path-domain": "planning/path_domain",
    "time-domain": "planning/time_domain",
    "robust-plans": "planning/robust",
    "verification": "verification",
    "messages": "cli",
    "search": "search",
    "map": "mapping",
    "policy": "policy",
    "robustness": "robustness",
    "engines": "engines",
    "slow-motions": "quasistatic",
    "tuning": "tuning",
    "comparison": "comparison",
    "simulation": "simulation",
    "free-simulation": "free_simulation",
    "output-files": "results",
    "figures": "figures",
    "movies": "viewer",
    "studies": "benchmark",
}
"""Folder of the page of each topic."""


def show(options: argparse.Namespace) -> int:
    """Print a page, or the topics."""
    if options.topic is not None:
        print(read_page(TOPICS[options.topic]), end="")
        return 0
    for topic, folder in TOPICS.items():
        print(f"{topic:16} {read_page(folder).splitlines()[0].removeprefix('# ')}")
    return 0


def read_page(folder: str) -> str:
    """The page of a folder, with topics in place of links to other pages."""
    page = resources.files("wholearm").joinpath(*folder.split("/"), "README.md")
    topics = {posixpath.join(own, "README.md"): topic for topic, own in TOPICS.items()}

    def name(link: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(folder, link[2]))
        return f"{link[1]} (wholearm help {topics[target]})" if target in topics else link[1]

    text = page.read_text(encoding="utf-8")
    return re.sub(r"\[([^\]]+)\]\(([^)#]*)(?:#[^)]*)?\)", name, text)
