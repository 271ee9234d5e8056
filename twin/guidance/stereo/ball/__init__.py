"""The ball on the tool in a picture: rendered, found, and measured to a hundredth of a pixel."""
