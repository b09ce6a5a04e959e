"""Forward simulation that finds the contacts itself, from event to event.

Nothing is assumed about which features touch: a complementarity problem says at every event which
contacts press, and which slide or stick. Of the simulator that is told its contacts it takes the
Runge-Kutta step and the layout of packed vectors; equations of motion and events are its own.
"""
