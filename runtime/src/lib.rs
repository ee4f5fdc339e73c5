//! Light in a participating medium.
