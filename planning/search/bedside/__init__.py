"""Where a needle enters, and how it leans, in words that can be measured on the skin and set at the scanner.

It reads a direction and the markers, and decides nothing.
"""
