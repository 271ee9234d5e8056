"""Tables of a case that describe what moves: the breath; and what they become in mm, in the CT's frame.

Each module holds the keys of its tables and the function that turns them into settings.
"""
