"""The iterations of ``mass_split`` on the CPU, where a thread takes one contact after another."""

import functools

import warp as wp

from warp_corot.kernels.modules import INLINED, unique_kernel
from warp_corot.kernels.stepping.pace import DT, Pace

from .locate import list_by_warp
from .mass_split import LOCATE, Contact, Contacts, Sums, clear_lists, end_place, parents_of, phases
from .motion import Surface
from .vertices import OUT, WAITS
from .watch import Near

wp.set_module_options({"enable_backward": False})


@wp.func
def is_pushed(contact: Contact, surface: Surface, sums: Sums):
    """Whether any contact has acted on a place of this one, which otherwise goes on waiting."""
    pushed = int(0)
    for k in range(4):
        if contact.weights[k] != 0.0:
            parents = contact.parents
            if k > 0:
                parents = parents_of(contact.places[k], surface)
            for m in range(4):
                pushed |= sums.touched[parents.nodes[m]]
    return pushed != 0


@functools.cache
def sweeper(has_triangles: bool, has_pairs: bool) -> wp.Kernel:
    """The kernel of these contacts, for the CPU; see ``phases``."""
    of = phases(has_triangles, has_pairs)
    contact_of, keep, locate, iterate = of.contact_of, of.keep, of.locate, of.iterate
    contact_count, number_of = of.contact_count, of.number_of

    @wp.func
    def correct(number: int, before: int, dt: float, all: Contacts, sums: Sums):
        """Correct the force of a contact in memory; see ``iterate``."""
        contact = contact_of(number, dt, all)
        if contact.acts != OUT:
            keep(number, iterate(contact, before, all.rigid.law, all.rigid.surface, sums), all)

    @wp.func
    def correct_listed(
        k: int, phase: int, iterations: int, dt: float, all: Contacts, records: wp.array[Contact], sums: Sums
    ):
        """Correct the force of the k-th contact that may act; between iterations it is in a record."""
        contact = Contact()
        if phase == LOCATE + 1:
            contact = contact_of(sums.live[k], dt, all)
        if phase > LOCATE + 1:
            contact = records[k]
        if contact.acts != WAITS or is_pushed(contact, all.rigid.surface, sums):
            contact = iterate(contact, (phase - 1) % 2, all.rigid.law, all.rigid.surface, sums)
        if phase < iterations:
            records[k] = contact
        else:
            keep(sums.live[k], contact, all)

    @unique_kernel(cpu_compiler_flags=INLINED)
    def sweep_contacts(
        # In
        threads: int,
        thread: int,
        first: int,
        last: int,
        iterations: int,
        are_separate: int,
        awake: wp.array[wp.int32],
        near: Near,
        listed: wp.array[wp.int32],
        listed_count: wp.array[wp.int32],
        pace: Pace,
        # In and out
        all: Contacts,
        records: wp.array[Contact],
        sums: Sums,
    ):
        """Make some phases of a step; see ``solve_contacts``.

        Args:
            threads, thread: The number of threads, each of which has a launch of its own, and this one.
            listed, listed_count: The contacts of places and of pairs that may act, and how many there are; empty: any.
            records: Memory for as many contacts as there usually are.
        """
        if awake[0] == 0:
            return
        dt = float(pace.seconds[DT])
        if first == LOCATE:
            count = contact_count(near, all)
            if listed.shape[0] > 0:
                count = listed_count[0] + near.touch_count[0]
            k = int(thread)
            while k < count:
                number = int(-1)
                if listed.shape[0] == 0:
                    number = number_of(k, near, all)
                elif k < listed_count[0]:
                    number = listed[k]
                else:
                    number = all.first_triangle + near.touches[k - listed_count[0]]
                may_act = int(0)
                if number >= 0:
                    may_act = locate(number, dt, all, sums)
                if may_act != 0 and are_separate == 0:
                    list_by_warp(sums.live, sums.live_count, number, 1)
                elif may_act != 0:
                    for iteration in range(iterations):
                        correct(number, iteration % 2, dt, all, sums)
                k += threads
        phase = wp.max(first, LOCATE + 1)
        while phase <= wp.min(last, iterations) and are_separate == 0:
            k = int(thread)
            while k < sums.live_count[0]:
                if k < records.shape[0]:
                    correct_listed(k, phase, iterations, dt, all, records, sums)
                else:
                    correct(sums.live[k], (phase - 1) % 2, dt, all, sums)
                k += threads
            phase += 1
        if last > iterations:
            if thread == 0:
                clear_lists(sums)
            k = int(thread)
            while k < near.count[0]:
                end_place(near.nodes[k], iterations % 2, near, all, sums)
                k += threads

    return sweep_contacts
