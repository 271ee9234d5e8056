"""New cases: from a folder with a CT and a segmentation, the text of a case that can be searched.

What a file is, is found by its content. Each kind of segmentation has a recogniser, and gives what `Segmentation`
demands; the finder tries them all.
"""
