"""Torques as a function of the joints: policies made from plans, and their step in a control loop.

Making a policy uses the model of the hand; its step uses nothing but the tables in its file.
"""
