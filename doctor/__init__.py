"""What is wrong with a rig, measured, each finding beside its limit; and a certificate for one that is well."""
