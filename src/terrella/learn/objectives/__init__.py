"""What can be learned: each objective gives modules, learners and losses; the trainer does the rest."""
