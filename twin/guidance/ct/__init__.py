"""Guidance by CT: what is read off a scan. Markers, a lesion, a needle; from voxels alone, never from the plant."""
