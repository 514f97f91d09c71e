"""Registration: frames of robot, instrument, tools and cameras from measurements."""
