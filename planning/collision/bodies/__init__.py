"""The bodies of an arm with its tool, as FCL objects that move with the joints, and what is proven to enclose them."""
