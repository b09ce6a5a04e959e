"""Feedback policies: joint torques from joint angles and speeds, made from plans.

Making a policy uses the model of the hand; its step uses nothing but the tables in its file.
"""
