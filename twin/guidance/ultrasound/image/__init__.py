"""B-mode images: speckle and needle as a probe shows them, and the needle detected in them."""
