"""What a command about a patient calls its files."""

PAGE, SLICES = "report.html", "slices.png"
PICTURES = ("map.png", "scene.png", SLICES, PAGE)
"""What a search writes beside its table; slices only where there is a direction to show."""

FILM, ROOMS = "rehearsal.mp4", "rooms.png"
