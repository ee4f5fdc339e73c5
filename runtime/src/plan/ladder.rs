//! Named settings of the methods, from the cheapest to the finest. Their errors and seconds are in the measured table,
//! by name: a rung that changes needs measuring again (`smoke-bake sweep --ladder=NAME`).

use super::Survey;
use crate::march::MarchSettings;
use crate::renderer::{RenderSettings, Route};
use crate::transport::ScatteringOrder;
use crate::transport::compensated::centres::route::CentreSettings;
use crate::transport::compensated::grid::route::{GridSettings, least_multiple_step};
use crate::transport::transfer::source::TransferSettings;

/// One step of the ladder.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rung {
    /// Its name, in the table too.
    pub name: &'static str,
    /// What it does, in words.
    pub words: &'static str,
    /// All its dials; none for the reference, whose one dial is the error it stops at.
    pub settings: Option<RenderSettings>,
}

/// The rung that `render` takes when nothing is asked.
pub const DEFAULT: &str = "default";
/// The rung of baked transfer.
pub const TRANSFER: &str = "transfer";
/// The rung that serves everything.
pub const REFERENCE: &str = "reference";

impl Rung {
    /// Name of the method in [`super::methods::METHODS`].
    pub fn method(&self) -> &'static str {
        match self.settings.map(|s| s.route) {
            Some(Route::Grid(_)) => "grid",
            Some(Route::Centres(_)) => "centres",
            Some(Route::Transfer(_)) => "transfer",
            None => REFERENCE,
        }
    }

    /// Its dials for the scene of `survey`: spacings that would be more nodes than fit into memory are left to the grid
    /// route itself.
    pub fn settings_for(&self, survey: &Survey) -> Option<RenderSettings> {
        let mut settings = self.settings?;
        if let Route::Grid(grid) = &mut settings.route {
            let least = [survey.medium.steps[0], least_multiple_step(survey.medium.dims)];
            for (step, least) in [&mut grid.single_step, &mut grid.multiple_step].into_iter().zip(least) {
                *step = if *step < least { 0 } else { *step };
            }
        }
        Some(settings)
    }

    /// True if `render` can go this way from the density alone: with dials, and without a bake of transfer.
    pub fn is_fast(&self) -> bool {
        self.settings.is_some_and(|s| !matches!(s.route, Route::Transfer(_)))
    }

    /// True if light scattered once is all that it has.
    pub fn is_single(&self) -> bool {
        self.settings.is_some_and(|s| s.scattering == ScatteringOrder::Single)
    }
}

/// All rungs; those of the grid from coarse to fine, then the other methods'.
pub fn ladder() -> [Rung; 11] {
    let base = RenderSettings::default();
    let grid = GridSettings::default();
    let rung = |name, words, settings| Rung { name, words, settings: Some(settings) };
    let single = |beams, single_step, step| RenderSettings {
        route: Route::Grid(GridSettings { beams, single_step, ..grid }),
        scattering: ScatteringOrder::Single,
        march: MarchSettings { step, ..base.march },
        ..base
    };
    let all = |sh_order, beams, steps: [usize; 2], rings, multiple_order, step| RenderSettings {
        route: Route::Grid(GridSettings {
            beams,
            single_step: steps[0],
            multiple_step: steps[1],
            rings,
            multiple_order,
            ..grid
        }),
        sh_order,
        march: MarchSettings { step, ..base.march },
        ..base
    };
    [
        rung("single-draft", "light scattered once, 16 beams, every second voxel", single(16, 2, 2.0)),
        rung("single", "light scattered once", single(grid.beams, 0, 0.0)),
        rung(
            "sketch",
            "8 beams, every fourth voxel; multiple scattering every eighth voxel, 2 rings, 1 band",
            all(2, 8, [4, 8], 2, 1, 2.0),
        ),
        rung(
            "draft",
            "16 beams, every second voxel; multiple scattering every fourth voxel, 3 rings, 1 band",
            all(3, 16, [2, 4], 3, 1, 2.0),
        ),
        rung(
            "coarse",
            "32 beams; multiple scattering every third voxel, 4 rings, 2 bands",
            all(4, 32, [1, 3], 4, 2, 1.0),
        ),
        rung(
            "middle",
            "64 beams; multiple scattering every second voxel, 4 rings, 3 bands",
            all(4, grid.beams, [0, 2], 4, 3, 0.0),
        ),
        rung(DEFAULT, "64 beams; multiple scattering every second voxel or finer, 5 rings, 3 bands", base),
        rung(
            "fine",
            "256 beams, 6 bands; multiple scattering at every voxel, 8 rings, 3 bands; half-voxel march, 4 rays a pixel",
            RenderSettings {
                march: MarchSettings { step: 0.5, samples: 2, ..base.march },
                ..all(6, 256, [0, 1], 8, 3, 0.0)
            },
        ),
        rung(
            "centres",
            "at the Gaussians' centres: direct exponential, integral transport",
            RenderSettings { route: Route::Centres(CentreSettings::default()), ..base },
        ),
        rung(
            TRANSFER,
            "baked for this medium with dsf642 and the other defaults of `bake --transfer`",
            RenderSettings { route: Route::Transfer(TransferSettings::default()), ..base },
        ),
        Rung { name: REFERENCE, words: "unbiased path tracing until its noise is below the error", settings: None },
    ]
}

/// The rung called `name`.
pub fn rung(name: &str) -> Option<Rung> {
    ladder().into_iter().find(|rung| rung.name == name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_rung_has_its_own_name_and_dials_and_the_default_is_that_of_render() {
        let all = ladder();
        for (i, a) in all.iter().enumerate() {
            assert!(all[..i].iter().all(|b| a.name != b.name && a.settings != b.settings), "{}", a.name);
        }
        assert_eq!(rung(DEFAULT).unwrap().settings, Some(RenderSettings::default()));
        assert_eq!(rung(REFERENCE).unwrap().method(), "reference");
        assert_eq!(rung("centres").unwrap().method(), "centres");
        assert_eq!(rung(TRANSFER).unwrap().method(), "transfer");
        let fast: Vec<&str> = all.iter().filter(|rung| !rung.is_fast()).map(|rung| rung.name).collect();
        assert_eq!(fast, [TRANSFER, REFERENCE]);
        let mut large = crate::plan::tests::survey(1.0, 0.9, 0.0);
        let step = |survey: &Survey| match rung("fine").unwrap().settings_for(survey).unwrap().route {
            Route::Grid(grid) => grid.multiple_step,
            Route::Centres(_) | Route::Transfer(_) => panic!("fine is of the grid"),
        };
        assert_eq!(step(&large), 1);
        large.medium.dims = [500; 3];
        assert_eq!(step(&large), 0);
        assert!(rung("single").unwrap().is_single() && rung("none").is_none());
    }
}
