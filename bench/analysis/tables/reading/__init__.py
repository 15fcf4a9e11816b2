"""Tables of measurements in files: text in many layouts, MATLAB files, spreadsheets and Parquet.

Text is read by `numpy.loadtxt`, which needs no library beyond those of the base, parses numbers exactly and reads
10⁶ rows of three columns in half a second; what it cannot read is looked at cell by cell for a message.
"""
