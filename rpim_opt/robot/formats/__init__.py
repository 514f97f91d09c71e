"""Files that describe robots, one module a format."""
