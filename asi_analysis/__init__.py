"""What happens after a run: bags, step and limit-cycle analysis, reports, the `asi` command."""
