"""What `terrella train` does: each recipe composes feeds and objectives into stages of one run."""
