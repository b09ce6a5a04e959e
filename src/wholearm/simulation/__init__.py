"""Forward simulation with contacts and joints that stick, slip and are gained.

Contacts are those of a problem's phases, or found by a complementarity problem at every event.

It shares the data model with the planner (`scene`, `contacts`, `problem`, `results`), and of what
is computed from it these alone, each with an independent check among the tests: `compute_impact`
and `ViolationKind` of `mechanics.impact` (plastic impacts); `Statics`, `TorquePolygon`, `GRAZE` and
`SURE` of `mechanics.statics` (balance, freedoms and closed gaps at rest); and `close_all` and
`solve_min_norm` of `mechanics.dynamics` (projection onto closed contacts, their acceleration).
Equations of motion, their integration, events and the choice of contact modes are its own.
"""
