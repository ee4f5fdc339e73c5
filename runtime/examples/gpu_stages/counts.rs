//! Bytes and operations of each stage on the device, for a grey frame under a sky and a sun, and what they predict.
//!
//! Bytes: what must pass through memory if all that is read twice by one dispatch comes from a cache the second time.
//! Operations: additions and multiplications of the shader, an exponential as 12, a root or quotient as 4. So times are
//! lower bounds: gathers that miss the cache, and threads that wait for the longest ray beside them, come on top.

/// What brings a stage about.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum When {
    /// Other light, or another medium.
    Light,
    /// Another eye.
    View,
}

/// One stage.
pub struct Stage {
    /// The method it belongs to.
    pub method: &'static str,
    /// As the device's times name it.
    pub name: &'static str,
    pub when: When,
    pub bytes: f64,
    pub operations: f64,
    /// Submissions and read-backs that the processor waits for.
    pub waits: f64,
}

/// What a frame and an image have of everything.
pub struct Shape {
    /// Nodes of the box.
    pub nodes: f64,
    /// Those near density.
    pub near: f64,
    /// Bricks with density.
    pub bricks: f64,
    /// Gaussians, and how many reach a node.
    pub gaussians: f64,
    pub reaching: f64,
    /// Directions from the eye that transfer is found for.
    pub views: f64,
    /// Pixels, and samples of all rays in dense bricks.
    pub pixels: f64,
    pub samples: f64,
}

/// Beams: 64 of the sky and a sun.
const BEAMS: f64 = 65.0;
/// Planes of four and of three bands.
const PLANES: f64 = 16.0;
const MULTIPLE_PLANES: f64 = 9.0;
/// Ordinates of multiple scattering, and products of its iteration.
const ORDINATES: f64 = 50.0;
const PRODUCTS: f64 = 10.0;
/// Directions of the quadrature at centres, and pairs of the four harmonics that the transport matrix has.
const QUADRATURE: f64 = 98.0;
const PAIRS: f64 = 10.0;
/// Nodes of a brick, bytes of a node and of a float.
const BRICK: f64 = 125.0;
const NODE: f64 = 16.0;
const FLOAT: f64 = 4.0;
/// Vectors of all clusters of transfer (128 of 1 + 4), directions of direct and lights of indirect light.
const VECTORS: f64 = 640.0;
const DIRECT: f64 = 642.0;
const INDIRECT: f64 = 162.0;
/// Operations to evaluate the harmonics of four bands.
const HARMONICS: f64 = 120.0;

/// All stages, in their order.
pub fn stages(shape: &Shape) -> Vec<Stage> {
    let Shape { nodes, near, bricks, gaussians, reaching, views, pixels, samples } = *shape;
    let stage = |method, name, when, bytes, operations, waits| Stage { method, name, when, bytes, operations, waits };
    // The grid of multiple scattering has every other node along an axis.
    let (coarse, coarse_near) = (nodes / 8.0, near / 8.0);
    // A sweep reads the density and leaves a depth at every ray and slice; the nodes read the depth and add planes.
    let batches = (BEAMS * FLOAT * nodes / 268e6).ceil();
    let sweep = |nodes: f64, near: f64, planes: f64| {
        let bytes = BEAMS * FLOAT * (2.0 * nodes + near) + batches * 2.0 * FLOAT * near * planes;
        (bytes, BEAMS * (22.0 * nodes + (20.0 + 2.0 * planes) * near))
    };
    let (fine, first) = (sweep(nodes, near, PLANES), sweep(coarse, coarse_near, MULTIPLE_PLANES));
    // Sources along an ordinate; radiance, depth and opacity of its rays; what reaches the nodes.
    let gather_bytes =
        ORDINATES * FLOAT * ((MULTIPLE_PLANES + 1.0) * coarse_near + (2.0 + 3.0) * coarse + 3.0 * coarse_near)
            + 2.0 * FLOAT * MULTIPLE_PLANES * coarse_near;
    let gather_operations = ORDINATES
        * (2.0 * MULTIPLE_PLANES * coarse_near + 45.0 * coarse + (40.0 + 2.0 * MULTIPLE_PLANES) * coarse_near);
    // A product's vector against half of the basis: a dot product (two streams) and a sum (three).
    let vector = MULTIPLE_PLANES * coarse_near;
    let basis = PRODUCTS / 2.0;
    let iteration_bytes = gather_bytes + basis * 5.0 * FLOAT * vector;
    let iteration_operations = gather_operations + basis * 4.0 * vector;
    let brick_nodes = BRICK * bricks;
    // The planes once; the nodes are read and written for each of two layers, and the density is put beside them.
    let volume_bytes = FLOAT * (PLANES * nodes + MULTIPLE_PLANES * coarse) + brick_nodes * (3.0 * 2.0 * NODE + FLOAT);
    let volume_operations = brick_nodes * (2.0 * PLANES + 32.0 * MULTIPLE_PLANES + 2.0 * HARMONICS);
    let march_bytes = brick_nodes * NODE + 2.0 * NODE * pixels;
    // Seven interpolations of four channels, three exponentials, the sums.
    let march_operations = samples * (84.0 + 36.0 + 20.0);
    let march = |method| stage(method, "view pass", When::View, march_bytes, march_operations, 2.0);
    let centres_operations =
        bricks * gaussians * 12.0 + brick_nodes * (HARMONICS + reaching * (20.0 + 6.0 * PLANES + 8.0));
    let moments = VECTORS * PLANES * INDIRECT;
    let cells = near / 8.0;
    let lit_bytes = FLOAT * VECTORS * DIRECT + views * NODE * (DIRECT + VECTORS);
    let lit_operations = views * (6.0 * VECTORS * DIRECT + 40.0 * DIRECT);
    let cell_bytes = cells * (5.0 * FLOAT + 2.0 * NODE);
    let cell_operations = cells * (HARMONICS + PLANES * (5.0 * 6.0 + 6.0));
    // Indirect light, direct light and the density each write the nodes; a node has a cluster and four weights.
    let node_bytes = brick_nodes * (5.0 * NODE + 5.0 * FLOAT + 3.0 * FLOAT);
    let node_operations = brick_nodes * (90.0 + 60.0 + 4.0 * 5.0 * 6.0);
    let (grid, at_centres, transfer) = ("compensated, grid", "compensated, centres", "transfer");
    vec![
        stage(grid, "single scattering", When::Light, fine.0 + first.0, fine.1 + first.1, batches + 1.0),
        stage(
            grid,
            "multiple scattering",
            When::Light,
            PRODUCTS * iteration_bytes,
            PRODUCTS * iteration_operations,
            2.0 * PRODUCTS + 3.0,
        ),
        stage(grid, "volume pass", When::View, volume_bytes, volume_operations, 1.0),
        march(grid),
        stage(
            at_centres,
            "single scattering at centres",
            When::Light,
            FLOAT * QUADRATURE * gaussians * (1.0 + PLANES),
            gaussians * PLANES * QUADRATURE * (3.0 * 15.0 + 6.0),
            2.0,
        ),
        stage(
            at_centres,
            "product of centres",
            When::Light,
            PRODUCTS * PAIRS * FLOAT * gaussians * gaussians,
            PRODUCTS * PAIRS * 4.0 * gaussians * gaussians,
            2.0 * PRODUCTS,
        ),
        stage(at_centres, "volume pass of centres", When::View, brick_nodes * (NODE + FLOAT), centres_operations, 1.0),
        march(at_centres),
        stage(transfer, "light of the transfer", When::Light, FLOAT * moments, 6.0 * moments, 1.0),
        stage(
            transfer,
            "volume pass of transfer",
            When::View,
            lit_bytes + cell_bytes + node_bytes,
            lit_operations + cell_operations + node_operations,
            1.0,
        ),
        march(transfer),
    ]
}

/// A device that times are predicted for.
pub struct Card {
    pub name: &'static str,
    /// Bytes and operations a second.
    pub bandwidth: f64,
    pub arithmetic: f64,
}

/// Ours to check, and the paper's.
pub const CARDS: [Card; 2] = [
    Card { name: "H100 SXM", bandwidth: 3.35e12, arithmetic: 67e12 },
    Card { name: "8800 GTX", bandwidth: 86.4e9, arithmetic: 346e9 },
];
/// Seconds of a submission or read-back that is waited for.
const WAIT: f64 = 10e-6;

impl Card {
    /// Least seconds of a stage.
    pub fn seconds(&self, stage: &Stage) -> f64 {
        (stage.bytes / self.bandwidth).max(stage.operations / self.arithmetic) + WAIT * stage.waits
    }
}
