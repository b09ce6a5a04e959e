"""Lower bounds of the least time along curves, without the planner and its NLP."""
