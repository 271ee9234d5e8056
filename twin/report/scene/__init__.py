"""The scene as a picture and as a film: patient, corridor of safe directions, needle and arm."""
