"""Where two cameras and an ultrasound probe go, and what they see of needle and target, by geometry alone."""
