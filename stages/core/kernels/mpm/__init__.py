"""Material point method: transfers, grid boundary conditions, constitutive models and two launch orders, in Warp."""
