"""How much error a plan bears: samples of scenes and torques, replayed free of assumptions."""
