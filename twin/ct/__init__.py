"""The CT way of guidance: a virtual scanner that reads markers, and a robot that touches them with its tip."""
