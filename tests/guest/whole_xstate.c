// Lets user-mode Linux 6.1 run on a processor with AMX: preloaded into linux.uml by vcan-guest.
//
// That kernel keeps 2,696 bytes of a guest process's extended processor state (XSAVE, as far as AVX-512 and PKRU) and
// writes just those back with PTRACE_SETREGSET. The host takes nothing but the whole state, 11,008 bytes where there
// is AMX, and refuses; the guest's first process then ends in put_fp_registers. So what the kernel kept goes over the
// first part of what the process has, and all of that is written.

#define _GNU_SOURCE
#include <dlfcn.h>
#include <elf.h>
#include <stdarg.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/types.h>
#include <sys/uio.h>

static long (*next_ptrace)(enum __ptrace_request, pid_t, void *, void *);

__attribute__((constructor)) static void find_next(void) { next_ptrace = dlsym(RTLD_NEXT, "ptrace"); }

long ptrace(enum __ptrace_request request, ...)
{
    va_list rest;
    va_start(rest, request);
    pid_t pid = va_arg(rest, pid_t);
    void *address = va_arg(rest, void *);
    void *data = va_arg(rest, void *);
    va_end(rest);

    static char state[1 << 16]; // one is enough: the kernel's only processor asks for one process at a time
    struct iovec whole = {state, sizeof state};
    const struct iovec *kept = data;
    if (request == PTRACE_SETREGSET && (long)address == NT_X86_XSTATE
        && next_ptrace(PTRACE_GETREGSET, pid, address, &whole) == 0 && kept->iov_len < whole.iov_len) {
        memcpy(state, kept->iov_base, kept->iov_len);
        data = &whole;
    }
    return next_ptrace(request, pid, address, data);
}
