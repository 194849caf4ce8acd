//! A scene into radiance by a plain f64 path tracer on the CPU: the oracle of every image test.
//!
//! It follows `docs/RENDERING.md` and shares no code with the shaders.

pub mod microfacet;
