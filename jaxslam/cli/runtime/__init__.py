"""What a command runs on: devices, kept programs, the time compilation takes."""
