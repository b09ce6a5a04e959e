"""Torques found as by hand: from quasistatic ones, by steps of 10 %, judged by simulations."""
