// Harmonics of the bands below `bands`, band by band: the recurrences of harmonics.rs written out, as an array that is
// indexed by what only the run knows would live in memory. q_lm: Legendre functions over sin^m; r_m + i i_m = (x + iy)^m.
fn harmonics(bands: u32, d: vec3<f32>) -> array<f32, 36> {
    var out: array<f32, 36>;
    let q00 = 1.0;
    out[0] = 0.282094792 * q00;
    if bands == 1u { return out; }
    let r1 = d.x;
    let i1 = d.y;
    let q10 = 1.0 * d.z;
    out[2] = 0.488602512 * q10;
    let q11 = -1.0;
    out[3] = 0.488602512 * q11 * r1;
    out[1] = 0.488602512 * q11 * i1;
    if bands == 2u { return out; }
    let r2 = r1 * d.x - i1 * d.y;
    let i2 = r1 * d.y + i1 * d.x;
    let q20 = 1.5 * d.z * q10 - 0.5 * q00;
    out[6] = 0.630783131 * q20;
    let q21 = -3.0 * d.z;
    out[7] = 0.36418281 * q21 * r1;
    out[5] = 0.36418281 * q21 * i1;
    let q22 = 3.0;
    out[8] = 0.182091405 * q22 * r2;
    out[4] = 0.182091405 * q22 * i2;
    if bands == 3u { return out; }
    let r3 = r2 * d.x - i2 * d.y;
    let i3 = r2 * d.y + i2 * d.x;
    let q30 = 1.66666667 * d.z * q20 - 0.666666667 * q10;
    out[12] = 0.746352665 * q30;
    let q31 = 2.5 * d.z * q21 - 1.5 * q11;
    out[13] = 0.3046972 * q31 * r1;
    out[11] = 0.3046972 * q31 * i1;
    let q32 = 15.0 * d.z;
    out[14] = 0.0963537148 * q32 * r2;
    out[10] = 0.0963537148 * q32 * i2;
    let q33 = -15.0;
    out[15] = 0.0393362393 * q33 * r3;
    out[9] = 0.0393362393 * q33 * i3;
    if bands == 4u { return out; }
    let r4 = r3 * d.x - i3 * d.y;
    let i4 = r3 * d.y + i3 * d.x;
    let q40 = 1.75 * d.z * q30 - 0.75 * q20;
    out[20] = 0.846284375 * q40;
    let q41 = 2.33333333 * d.z * q31 - 1.33333333 * q21;
    out[21] = 0.267618617 * q41 * r1;
    out[19] = 0.267618617 * q41 * i1;
    let q42 = 3.5 * d.z * q32 - 2.5 * q22;
    out[22] = 0.0630783131 * q42 * r2;
    out[18] = 0.0630783131 * q42 * i2;
    let q43 = -105.0 * d.z;
    out[23] = 0.0168583883 * q43 * r3;
    out[17] = 0.0168583883 * q43 * i3;
    let q44 = 105.0;
    out[24] = 0.00596034034 * q44 * r4;
    out[16] = 0.00596034034 * q44 * i4;
    if bands == 5u { return out; }
    let r5 = r4 * d.x - i4 * d.y;
    let i5 = r4 * d.y + i4 * d.x;
    let q50 = 1.8 * d.z * q40 - 0.8 * q30;
    out[30] = 0.93560258 * q50;
    let q51 = 2.25 * d.z * q41 - 1.25 * q31;
    out[31] = 0.241571547 * q51 * r1;
    out[29] = 0.241571547 * q51 * i1;
    let q52 = 3.0 * d.z * q42 - 2.0 * q32;
    out[32] = 0.0456527313 * q52 * r2;
    out[28] = 0.0456527313 * q52 * i2;
    let q53 = 4.5 * d.z * q43 - 3.5 * q33;
    out[33] = 0.00931882475 * q53 * r3;
    out[27] = 0.00931882475 * q53 * i3;
    let q54 = 945.0 * d.z;
    out[34] = 0.00219646806 * q54 * r4;
    out[26] = 0.00219646806 * q54 * i4;
    let q55 = -945.0;
    out[35] = 0.000694584187 * q55 * r5;
    out[25] = 0.000694584187 * q55 * i5;
    return out;
}
