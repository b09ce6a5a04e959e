"""From a problem to a plan: options, blocks of phases, advice, the check of the plan."""
