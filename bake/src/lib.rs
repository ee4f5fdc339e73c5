//! A density sequence in, a pack out.
