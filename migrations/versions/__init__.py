"""The revisions, oldest first by number.

They are v1, v2 and so on. Builds before 0.1.0 had 0001 to 0009, which no program reads any more.
"""
