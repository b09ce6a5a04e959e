"""Studies: what ``wholearm bench`` runs. Each is the `STUDY` of the module of its name."""

STUDIES = {
    "corpus": "ask everything that is answered, and compare answers and costs with stored ones",
    "queries": "ask for routes from pose to pose, and carry them out: how many, and how fast",
    "skip": "measure what each part of the model costs that a scene has or has not",
    "growth": "measure how cost grows with intervals, phases and vertices",
    "stress": "plan generated scenes and damaged files: what must not happen",
    "precision": "measure run time against error, with peers beside",
}
"""A line of help for each study, by its name."""
