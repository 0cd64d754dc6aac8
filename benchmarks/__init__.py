"""One file per question, each with --json."""
