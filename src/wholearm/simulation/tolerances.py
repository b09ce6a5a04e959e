"""Tolerances of the simulator, each relative to a scale of the scene (`Scene.scales`)."""

ROUNDING_FORCE = 1e-9  # shortfall of a force, torque or friction margin that is rounding
ROUNDING_SPEED = 2e-13  # largest negative speed that counts as rounding
ROUNDING_LIMIT = 3e-8  # overlap that is rounding: the contact just given up starts at zero
REACHED = 3e-5  # distance to the end of a phase that counts as there, at rest: the next overlaps
PASSED = 1e-5  # distance past the end of a phase at speed: error of a long motion before it
SLOW = 2e-4  # speed that counts as rest at the end of a phase
CREEPING = 1e-7  # speed of a fading motion that is not there yet: above integration error
STANDING = 1e-9  # speed that counts as none in friction: either sign by integration error
SETTLING = 2e-5  # longest time by which rounding moves an event; modes are judged as late
REST_WINDOW = 2e-3  # time of rest before a torque break: too short for contacts to part
LONGEST_WINDOW = 2e-2  # longest time between an arrival at speed and its torque break
FIRST_STEP = 2e-2  # length of the first step tried from rest
SHORTEST_STEP = 1e-13  # underflow of a step, over the scene's time and the elapsed time
STILL = 1e-10  # acceleration that counts as rounding
