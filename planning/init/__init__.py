"""The start: a folder with a CT and a segmentation in, the text of a case that runs out.

What a file is, is found by its content. Each kind of segmentation has a recogniser, and gives what `Segmentation`
demands; the finder tries them all.
"""
