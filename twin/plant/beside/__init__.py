"""What lies in a scanner beside the patient: arms, the bed, lines; each drawn about a skin, as closed surfaces.

It is ground truth: no segmentation names it, and who plans has to find it in the image.
"""
