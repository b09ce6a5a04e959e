"""Torques found by trial and error, in steps of 10 %, as Yeap and Trinkle tuned theirs by hand."""
