"""From declared errors to chances: the covariance of the needle's pose, the chance to hit and the chances to touch.

It knows the arm and the registration, and draws nothing at random; what draws the truth lives in the twin.
"""
