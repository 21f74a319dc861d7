"""Any network makes depth maps of posed frames."""
