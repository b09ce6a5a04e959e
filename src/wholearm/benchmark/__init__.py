"""Studies: what ``wholearm bench`` runs. Each is the `STUDY` of the module of its name."""

STUDIES = {
    "corpus": "ask everything that is answered, and compare with stored answers",
    "guard": "count what plans take by other measures than time, against stored counts",
    "queries": "ask for routes from pose to pose: how many are solved, and how fast",
    "execution": "carry routes out in every way: over time, by limited motors, by a policy",
    "skip": "measure what each part of the model costs that a scene has or has not",
    "growth": "measure how cost grows with intervals, phases and vertices",
    "stress": "plan generated scenes and damaged files: what must not happen",
    "precision": "measure run time against error, with peers beside",
}
"""A line of help for each study, by its name."""
