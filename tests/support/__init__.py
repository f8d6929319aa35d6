"""What tests share: the checkout, time limits, profiles, what a machine may lack."""
