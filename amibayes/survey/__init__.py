"""What many searches mean together: false alarms, completeness, frequency of companions."""
