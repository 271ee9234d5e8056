"""Pictures, pages and texts for a person. Here: colours, numbers, the map's projection, text on pictures, progress.

Pictures, map, scene and page have a room each. Nothing here decides; every number comes from a result.
"""
