"""The command ``servo``, its pictures and page, and the tables of Liu 2007."""
