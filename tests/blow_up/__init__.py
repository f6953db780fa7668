"""The steps at which scenes blow up, found by bisection, beside the steps that the solver predicts."""
