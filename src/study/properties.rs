//! The numbers of the reference tribometer that a study can vary, by name with unit.

use crate::fem::tribometer::Properties;

/// A number of the tribometer.
#[derive(Clone, Copy, Debug)]
pub struct Property {
    pub name: &'static str,
    pub of: fn(&mut Properties) -> &mut f64,
}

macro_rules! properties {
    ($($name:literal = $($path:ident).+ $([$index:literal])?;)*) => {
        /// All of them.
        pub const PROPERTIES: &[Property] =
            &[$(Property { name: $name, of: |properties| &mut properties.$($path).+ $([$index])? }),*];
    };
}

properties! {
    "pad_x_from_m" = dimensions.pad_x[0];
    "pad_x_to_m" = dimensions.pad_x[1];
    "pad_half_z_m" = dimensions.pad_half_z;
    "pad_height_m" = dimensions.pad_height;
    "pad_holder_half_x_m" = dimensions.pad_holder_half[0];
    "pad_holder_half_z_m" = dimensions.pad_holder_half[1];
    "pad_holder_height_m" = dimensions.pad_holder_height;
    "column_half_x_m" = dimensions.column_half[0];
    "column_half_z_m" = dimensions.column_half[1];
    "sensor_height_m" = dimensions.sensor_height;
    "shank_height_m" = dimensions.shank_height;
    "bearing_height_m" = dimensions.bearing_height;
    "collar_height_m" = dimensions.collar_height;
    "bearing_half_x_m" = dimensions.bearing_half_x;
    "bearing_depth_m" = dimensions.bearing_depth;
    "plate_depth_m" = dimensions.plate_depth;
    "cylinder_half_x_m" = dimensions.cylinder_half[0];
    "cylinder_half_z_m" = dimensions.cylinder_half[1];
    "cylinder_height_m" = dimensions.cylinder_height;
    "spring_holder_half_x_m" = dimensions.spring_holder_half[0];
    "spring_holder_half_z_m" = dimensions.spring_holder_half[1];
    "spring_holder_height_m" = dimensions.spring_holder_height;
    "disc_radius_m" = dimensions.disc_radius;
    "disc_thickness_m" = dimensions.disc_thickness;
    "bore_radius_m" = dimensions.bore_radius;
    "disc_holder_radius_m" = dimensions.disc_holder_radius;
    "disc_holder_height_m" = dimensions.disc_holder_height;
    "margin_radial_m" = dimensions.margin[0];
    "margin_along_m" = dimensions.margin[1];
    "pad_density_kg_per_m3" = materials.pad.density_kg_per_m3;
    "pad_young_pa" = materials.pad.young_pa;
    "pad_poisson" = materials.pad.poisson;
    "pad_holder_density_kg_per_m3" = materials.pad_holder.density_kg_per_m3;
    "pad_holder_young_pa" = materials.pad_holder.young_pa;
    "pad_holder_poisson" = materials.pad_holder.poisson;
    "force_sensor_density_kg_per_m3" = materials.force_sensor.density_kg_per_m3;
    "force_sensor_young_pa" = materials.force_sensor.young_pa;
    "force_sensor_poisson" = materials.force_sensor.poisson;
    "sensor_holder_density_kg_per_m3" = materials.sensor_holder.density_kg_per_m3;
    "sensor_holder_young_pa" = materials.sensor_holder.young_pa;
    "sensor_holder_poisson" = materials.sensor_holder.poisson;
    "linear_bearing_density_kg_per_m3" = materials.linear_bearing.density_kg_per_m3;
    "linear_bearing_young_pa" = materials.linear_bearing.young_pa;
    "linear_bearing_poisson" = materials.linear_bearing.poisson;
    "cylinder_density_kg_per_m3" = materials.cylinder.density_kg_per_m3;
    "cylinder_young_pa" = materials.cylinder.young_pa;
    "cylinder_poisson" = materials.cylinder.poisson;
    "spring_holder_density_kg_per_m3" = materials.spring_holder.density_kg_per_m3;
    "spring_holder_young_pa" = materials.spring_holder.young_pa;
    "spring_holder_poisson" = materials.spring_holder.poisson;
    "disc_density_kg_per_m3" = materials.disc.density_kg_per_m3;
    "disc_young_pa" = materials.disc.young_pa;
    "disc_poisson" = materials.disc.poisson;
    "disc_holder_density_kg_per_m3" = materials.disc_holder.density_kg_per_m3;
    "disc_holder_young_pa" = materials.disc_holder.young_pa;
    "disc_holder_poisson" = materials.disc_holder.poisson;
    "ground_spring_n_per_m" = supports.ground_spring_n_per_m;
    "middle_spring_n_per_m" = supports.middle_spring_n_per_m;
    "edge_spring_x_n_per_m" = supports.edge_spring_n_per_m[0];
    "edge_spring_y_n_per_m" = supports.edge_spring_n_per_m[1];
    "edge_spring_z_n_per_m" = supports.edge_spring_n_per_m[2];
}

impl Property {
    /// The property of this name.
    pub fn named(name: &str) -> Option<Self> {
        PROPERTIES.iter().find(|property| property.name == name).copied()
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn every_property_is_another_number_of_the_tribometer() {
        let mut properties = Properties::default();
        for (k, property) in (1..).zip(PROPERTIES) {
            *(property.of)(&mut properties) = f64::from(k);
        }
        for (k, property) in (1..).zip(PROPERTIES) {
            assert_eq!(*(property.of)(&mut properties), f64::from(k), "{}", property.name);
        }
        let numbers = std::mem::size_of::<Properties>() / std::mem::size_of::<f64>();
        assert_eq!(PROPERTIES.len(), numbers, "every number has a name");
        let names: BTreeSet<&str> = PROPERTIES.iter().map(|property| property.name).collect();
        assert_eq!(names.len(), PROPERTIES.len());
    }
}
