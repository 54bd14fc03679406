"""What a recording is: its camera, its weather, its sun, who drives in it."""
