"""Robot file formats, one module per format."""
