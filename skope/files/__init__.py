"""Files: reading users' files, atomic writing, checked names, and output folders."""
