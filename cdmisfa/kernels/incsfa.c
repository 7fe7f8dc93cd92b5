int incsfa_update(const incsfa *state, const frames *x, int gap, double *xi) { return 0; }
