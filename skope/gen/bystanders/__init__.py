"""People on foot, on bicycles and on motorcycles, who are drawn and not labelled."""
