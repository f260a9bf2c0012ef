/* The header is plain C. */
#include "@name@.h"

int header_is_c(void);
int header_is_c(void) { return sizeof(@name@_state) > sizeof(@name@_target); }
