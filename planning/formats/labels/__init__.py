"""Label maps: which number is which organ, by file or by TotalSegmentator's lists, and a label's surface."""
