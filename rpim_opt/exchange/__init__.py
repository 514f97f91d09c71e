"""Robot descriptions in and out: URDF, Universal Robots' files, plain tables. Each goes through `chain`."""
