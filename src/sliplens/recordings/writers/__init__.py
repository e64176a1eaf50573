"""Writers: data sets for other programs, one file a format."""
