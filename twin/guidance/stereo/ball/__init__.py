"""The ball on the tool in an image: rendered, found, and measured to a hundredth of a pixel."""
