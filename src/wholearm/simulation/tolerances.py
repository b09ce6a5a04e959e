"""Tolerances of the simulator, each relative to a scale of the scene (`Scene.scales`)."""

ROUNDING_FORCE = 1e-9  # shortfall of a force, torque or friction margin that is rounding
ROUNDING_SPEED = 2e-13  # largest negative speed that counts as rounding
REACHED = 3e-5  # distance to the end of a phase that counts as there, at rest: the next overlaps
SLOW = 2e-4  # speed that counts as rest at the end of a phase
STANDING = 1e-9  # speed that counts as none in friction: either sign by integration error
SETTLING = 2e-5  # longest time by which rounding moves an event; modes are judged as late
REST_WINDOW = 2e-3  # time of rest before a torque break: too short for contacts to part
FIRST_STEP = 2e-2  # length of the first step tried from rest
SHORTEST_STEP = 1e-13  # underflow of a step, over the scene's time and the elapsed time
STILL = 1e-10  # acceleration that counts as rounding
