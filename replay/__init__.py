"""Read logs and runs of cdmisfa, and show them: views, reports, exports, checks."""
