// A library in the manner of ONNX Runtime of which every call ends the process, as crafted models end the true one.

#include <stdint.h>
#include <stdlib.h>

// More calls than any version has.
enum { CALLS = 1024 };

static void end(void) { abort(); }

static void (*calls[CALLS])(void);

static const void *api(uint32_t version) {
    (void)version;
    for (int k = 0; k < CALLS; ++k) calls[k] = end;
    return calls;
}

static const char *version(void) { return "1.99.0"; }

struct base {
    const void *(*api)(uint32_t);
    const char *(*version)(void);
};

const struct base *OrtGetApiBase(void) {
    static const struct base base = {api, version};
#ifdef ENDS_AT_ONCE
    end();
#endif
    return &base;
}
