"""Studies: what ``wholearm bench`` runs."""

STUDIES = {
    "corpus": (".corpus", "ask everything that is answered, and compare with stored answers"),
    "guard": (".guard", "count what plans take by other measures than time, against stored counts"),
    "queries": (".queries", "ask for routes from pose to pose: how many are solved, and how fast"),
    "skip": (".skip", "measure what each part of the model costs that a scene has or has not"),
    "growth": (".growth", "measure how cost grows with intervals, phases and vertices"),
    "stress": (
        ".stress.stress_study",
        "plan generated scenes and damaged files: what must not happen",
    ),
    "precision": (
        ".precision.precision_study",
        "measure run time against error, with peers beside",
    ),
}
"""Module, whose `STUDY` it is, and a line of help for each study, by its name."""
