"""Problems with known answers, and hard cases."""
