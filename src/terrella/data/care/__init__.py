"""The doctor, who names the faults of a recording, and repair, which mends a copy."""
