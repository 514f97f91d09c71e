"""Table formats beside plain tables, one file each."""
