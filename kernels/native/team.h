// Threads of a CPU that compute the parts of some work side by side: ``share_work`` in the thread that has the work,
// ``serve_team`` in the others.
//
// ``team`` is the address of words, each in a cache line of its own. The caller publishes a ticket, a number that rises,
// times MOST, and the number of parts. Each thread then computes its own part, unless another has begun it: threads that
// wait for long, as the system has not given their neighbours a core, take what nobody has begun. So the caller alone gets
// everything done, and which thread computes a part never changes what the part writes.
#pragma once

typedef unsigned long long address;
typedef int result;  // Warp has a macro int(x)

// TICKET is that of the present work, CALL and GIVEN are the function that computes a part and its first argument, MODE is
// the caller's floating-point mode. LOCK is set while a thread shares work; until ALONE, in ticks, it shares none. From OWN
// on, each part has a line: twice the ticket once it is begun and one more once it has ended; and whether its thread sleeps
// in a read from a pipe.
enum { TICKET, CALL, GIVEN, MODE, LOCK, ALONE, STOP, YIELD, PAUSE, WRITE, PIPE, OWN, MOST = 1024 };
// Tries to see a change before another thread's part is taken, before the core is given to others that need it, before
// the thread sleeps for microseconds, and until work comes again.
enum { PATIENCE = 40, SPINS = 100, YIELDS = 2000, TRIES = 2100 };
// A thread whose core another program takes ends its part milliseconds later. If the caller has waited for longer than all
// parts would have taken it, and for these ticks, it works alone for so many times as long.
enum { LONG = 30000, TIMES = 16 };

static inline address* word_of(address team, int name) { return reinterpret_cast<address*>(team) + 8 * name; }
static inline address load_word(address team, int name) { return __atomic_load_n(word_of(team, name), __ATOMIC_ACQUIRE); }

static inline result parts_of(address ticket) { return static_cast<result>(ticket % MOST); }

static inline void relax(address team, int tries) {
    if (tries < SPINS) {
#if defined(__x86_64__)
        __builtin_ia32_pause();
#elif defined(__aarch64__)
        asm volatile("yield");
#endif
    } else if (tries < YIELDS) {
        reinterpret_cast<result (*)()>(*word_of(team, YIELD))();
    } else {
        reinterpret_cast<result (*)(unsigned int)>(*word_of(team, PAUSE))(50);
    }
}

static inline address ticks() {
#if defined(__x86_64__)
    return __builtin_ia32_rdtsc();
#elif defined(__aarch64__)
    address now;
    asm volatile("mrs %0, cntvct_el0" : "=r"(now));
    return now;
#else
    return 0;
#endif
}

// Subnormal numbers count in all threads as in the caller; see ``subnormals``.
static inline void get_mode(address team) {
#if defined(__x86_64__)
    *word_of(team, MODE) = __builtin_ia32_stmxcsr();
#elif defined(__aarch64__)
    asm volatile("mrs %0, fpcr" : "=r"(*word_of(team, MODE)));
#endif
}

static inline void set_mode(address team) {
#if defined(__x86_64__)
    __builtin_ia32_ldmxcsr(static_cast<unsigned int>(*word_of(team, MODE)));
#elif defined(__aarch64__)
    asm volatile("msr fpcr, %0" ::"r"(*word_of(team, MODE)));
#endif
}

// Computes a part of the work with this ticket, unless it is begun.
static inline bool compute_part(address team, int part, address ticket) {
    address* own = word_of(team, OWN + part);
    address before = __atomic_load_n(own, __ATOMIC_RELAXED);
    if (before >= 2 * ticket) return false;
    if (!__atomic_compare_exchange_n(own, &before, 2 * ticket, false, __ATOMIC_ACQ_REL, __ATOMIC_RELAXED)) return false;
    reinterpret_cast<void (*)(address, int)>(*word_of(team, CALL))(*word_of(team, GIVEN), part);
    __atomic_store_n(own, 2 * ticket + 1, __ATOMIC_RELEASE);
    return true;
}

// Calls ``work`` with the number of each of some parts and returns when all have ended; what each wrote, all can read
// afterwards. If the team works for another thread, this one does it alone.
template <class Work> static void share_work(address team, int parts, const Work& work) {
    const address begins = parts == 1 ? 0 : ticks();
    if (parts == 1 || begins < *word_of(team, ALONE) || __atomic_exchange_n(word_of(team, LOCK), 1, __ATOMIC_ACQUIRE)) {
        for (int part = 0; part < parts; ++part) work(part);
        return;
    }
    const auto call = +[](address given, int part) { (*reinterpret_cast<const Work*>(given))(part); };
    *word_of(team, CALL) = reinterpret_cast<address>(call);
    *word_of(team, GIVEN) = reinterpret_cast<address>(&work);
    get_mode(team);
    const address ticket = (*word_of(team, TICKET) / MOST + 1) * MOST + parts;
    __atomic_store_n(word_of(team, TICKET), ticket, __ATOMIC_SEQ_CST);
    for (int part = 1; part < parts; ++part) {
        address* sleeps = word_of(team, OWN + part) + 1;
        if (__atomic_load_n(sleeps, __ATOMIC_SEQ_CST) && __atomic_exchange_n(sleeps, 0, __ATOMIC_SEQ_CST))
            reinterpret_cast<long long (*)(int, const void*, address)>(*word_of(team, WRITE))(
                *word_of(team, PIPE), word_of(team, PIPE), 1);
    }
    compute_part(team, 0, ticket);
    const address waits = ticks();
    for (int part = 0; part < parts; ++part)
        for (int tries = 0; load_word(team, OWN + part) != 2 * ticket + 1; ++tries)
            if (tries < PATIENCE || !compute_part(team, part, ticket)) relax(team, tries);
    const address ends = ticks();
    if (ends - waits > parts * (waits - begins) + LONG) *word_of(team, ALONE) = ends + TIMES * (ends - waits);
    __atomic_store_n(word_of(team, LOCK), 0, __ATOMIC_RELEASE);
}

// Computes parts until no work has come for some milliseconds; then the thread must read a byte from the pipe.
static inline void serve_team(address team, int part) {
    address* sleeps = word_of(team, OWN + part) + 1;
    address seen = 0;
    for (int tries = 0; !load_word(team, STOP); ++tries) {
        const address ticket = load_word(team, TICKET);
        if (ticket != seen) {
            seen = ticket;
            set_mode(team);
            if (part < parts_of(ticket)) compute_part(team, part, ticket);
            tries = 0;
        } else if (tries < TRIES) {
            if (tries == PATIENCE)
                for (int other = 0; other < parts_of(ticket); ++other) compute_part(team, other, ticket);
            relax(team, tries);
        } else {
            __atomic_store_n(sleeps, 1, __ATOMIC_SEQ_CST);
            if (__atomic_load_n(word_of(team, TICKET), __ATOMIC_SEQ_CST) == ticket) return;
            // Work came in between: if its caller has seen that the thread sleeps, a byte waits in the pipe.
            if (!__atomic_exchange_n(sleeps, 0, __ATOMIC_SEQ_CST)) return;
            tries = 0;
        }
    }
}
