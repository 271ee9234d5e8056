"""The ultrasound guidance: two arms calibrate themselves through the needle that shows in the image, A X P = Y B Q.

Here are the case, the poses, the recording in the twin and the puncture after it; the equation is solved in `axp_ybq`.
"""
