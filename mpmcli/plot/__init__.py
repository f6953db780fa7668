"""The ledger of a result as one figure."""
