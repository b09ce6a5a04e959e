"""From a start to a goal: the contact formations that lead there, and a plan along them."""
