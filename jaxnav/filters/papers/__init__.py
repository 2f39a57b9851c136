"""The rules of the three papers, and one made of their parts."""
