"""Curves of one freedom, tangent spaces, and motions to start from."""
