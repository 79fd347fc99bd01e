"""Stub of python-prctl, which picamera2 imports for its video encoders only."""
