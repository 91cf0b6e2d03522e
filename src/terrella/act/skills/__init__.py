"""Skills: what a policy does at an instruction, when that can begin, what it brings about, and a planner of their orders."""
