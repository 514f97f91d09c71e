"""Table formats other than plain tables, one module each."""
